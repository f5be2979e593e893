"""Estimation of the lever arms from rotations.

dither_line, low_pass         dither in the angle increments, and the filter for it
channel, rigid_motion, pulses readings of a sensor at rest; its velocity in motion, free of its pulses
walk, noise                   random walks of the sensors
runs, readings                align and navigate each run, and read its velocities at rest
priors                        what is known of the unit
design, linear_system         derivatives, noise and normal equations
joint, consistency            joint estimate, the default, and its tests
plain                         V = H R
predict                       accuracy of a plan
result, observability         the estimate; what cannot be observed
"""
