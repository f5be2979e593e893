"""The live service.

loop           read, decode, compensate, publish
settings       settings file
status         health of a status
status_socket  unix socket that reports the status
runtime        signals, systemd, memory, priority
latency        latency statistics
printer        text for people, in the background
monitor        a running service on the terminal
"""
