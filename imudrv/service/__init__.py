"""The live service.

loop               read, decode, compensate, publish
port               supervision of the port
clock_watch        steps of the host's clock, and suspends
calibration_watch  replacement of the calibration when its file changes
recordings         recordings, begun and ended while running
events             event log
latency            latency statistics
runtime            signals, systemd, memory, priority
warm_up            compilation before the first sample
settings           settings file
status             status and health
status_socket      reports the status to those who ask
endpoint           where they ask: a Unix socket, or a port of the loopback
monitor            live view on the terminal
printer            background output of text
"""
