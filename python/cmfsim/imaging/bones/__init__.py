"""Bone in a scan: mask and edge, jaws told apart, metal and its streaks."""
