"""Estimator: samples become a set that holds the robot's pose."""
