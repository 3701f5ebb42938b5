"""Poses of parts in a bin as messages of ROS 2; see docs/ros.md of kmn_jax."""
