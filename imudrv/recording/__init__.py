"""Recordings of the driver service: MCAP files with wire data, increments, status and events.

format           channels and their encoding
reader           read a recording, also one that was cut
writer           write MCAP files, without and with chunks
pack             compress one
samples_channel  samples as plotting programs read them
export           convert to other formats
samples          increments to export, counted
waypoint         export to Waypoint and Inertial Explorer
ros2             export to ROS 2
"""
