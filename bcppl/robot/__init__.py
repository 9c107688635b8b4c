"""Robots: kinematics, reach, and the motions that an arm is commanded to make."""
