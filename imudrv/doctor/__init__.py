"""Find out why a unit is not received, and what to do.

examine   steps from the device to the data
device    the device: does it exist, can it be opened, do other programs use it
traffic   findings about received data
verdict   finding of one step
"""
