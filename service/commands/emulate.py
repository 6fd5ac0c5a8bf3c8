"""`terrabound emulate`: the emulated robot, whole or one device of it, on pseudo-terminals."""

from cyclopts import App

app = App(help="Emulate the robot's devices on pseudo-terminals, so that anything can be tried without hardware.")
