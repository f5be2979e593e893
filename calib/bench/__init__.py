"""A session at the bench with an operator.

entries, journal                        events of a session, and their append-only file
state, session                          what the journal determines, and the folder open for writing
result, verify                          recompute the result, audit
controller, queue_sink, recordings      worker thread: steps and their recordings
completion                              decision, certificate and report
screen, keys, block_letters             terminal of the operator
run, resume                             `calib run`, a new or an existing session
simulated_unit, technician              rehearsal
"""
