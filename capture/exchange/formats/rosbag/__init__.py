"""Recordings of ROS: bags of ROS 2 (MCAP, SQLite, folders) and of ROS 1."""
