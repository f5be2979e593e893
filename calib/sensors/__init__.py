"""Calibration of the sensors from rests in several poses and the motions between them.

Data flow::

    captures -> Evidence -> LinearSystem -> Adjustment -> SensorsResult -> certificate, report
           rests       equations      adjustment     calibrate

    parameters     what is estimated, as numbers of a certificate
    evidence       rests and motions, and the noise in them       rests  captures to evidence
    motion         one pass over a motion, with its Jacobians
    equations      rests and motions as equations, linearised, with their covariance
    axis_search    exchanged and reversed axes, before anything else
    adjustment     Gauss-Newton, and the size of the wander
    faces          body axes along the faces of the unit
    observability  what rests and motions show, and what not
    prediction     sigma of a plan, and which motion adds what
    calibrate      all of it                                      verdict, result, certificate
"""
