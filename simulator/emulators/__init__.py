"""Emulators: the device end of each wire, without ports and without a clock of their own."""
