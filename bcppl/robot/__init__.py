"""Robots: forward and inverse kinematics, and plans of compliant motions."""
