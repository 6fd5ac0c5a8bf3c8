"""The commands of the command line, one file each. Only these may import the simulator."""
