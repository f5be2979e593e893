"""Find out why a unit is not received, and what to do.

examine   the steps from the device to the traffic
device    the device: does it exist, may it be opened, who else has it
verdict   the result of a step
"""
