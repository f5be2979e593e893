"""Calibration of the sensors from rests in several poses and the motions between them.

captures -> Evidence -> Adjustment -> SensorsResult -> certificate, report
rests     equations    calibrate

parameters    what is estimated, as numbers of a certificate     rests          rests and motions of captures
motion        one pass over a motion, with its Jacobians         equations      rests and motions as equations
adjustment    Gauss-Newton, wander                               axis_search    exchanged and reversed axes
faces         body axes along the faces of the unit              observability  what is shown, and what not
prediction    sigma of a plan, and which motion adds what        verdict, certificate, result, calibrate
"""
