"""Recordings: MCAP files with wire bytes, increments, status, and what made them.

format    channels and their encoding
reader    read a recording, also one cut short
pack      compress one
export    convert to other formats: waypoint, ros2, tally for the loss summary
"""
