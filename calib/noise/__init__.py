"""Noise of a unit from a long rest: Allan deviations, and the coefficients of the model of IEEE 647 and 952.

    pulses -> StretchSplitter -> Pyramid -> AllanVariance -> Fit, Bounds -> NoiseResult

pyramid      overlapping Allan variance in one pass and constant memory
stretches    which samples are at rest, without a gap
model        the five kinds of noise, and their units
estimates    covariance of the Allan variances
fit          coefficients by generalised least squares
bounds       what holds for data that the model does not describe
analysis     captures to a result with its verdict
documents    the result as JSON and in a certificate
"""
