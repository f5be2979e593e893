"""Does compensation help? The same pulses navigated without and with the size effect, and judged.

trial       one trial and its settings
navigate    navigate a trial
skew        correct a gyro-accelerometer skew
verdict     metrics and verdict
simulate    the four tests on a simulated unit
montecarlo  identification of many simulated units
"""
