"""Compare navigation of the same pulses with and without size-effect compensation.

trial       a trial and its settings
navigate    navigate a trial
skew        correct a gyro-accelerometer skew
verdict     metrics and verdict
simulate    the four tests on a simulated unit
montecarlo  identification of many simulated units
"""
