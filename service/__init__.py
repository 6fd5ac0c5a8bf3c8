"""Service: the process on the robot, its command line, and the remote subscriber."""
