"""A session at the bench with an operator.

session, journal, evidence, verify      store, recompute, audit
controller, queue_sink                  worker thread
screen, keys, block_letters             terminal of the operator
run, simulated_unit, technician         `calib run`, rehearsal
"""
