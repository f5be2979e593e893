"""Out: where pulses and increments go."""
