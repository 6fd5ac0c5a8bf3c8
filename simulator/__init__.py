"""Simulator: the true robot on the true terrain, and the other end of each wire. Shares no code with what it tests."""
