"""Estimation of the lever arms from rotations.

low_pass       filter for the dither in the angle increments
runs           align and navigate each rotation
linear_system  design matrix, covariance, normal equations, observability
joint          joint estimate, the default
plain          V = H R
predict        accuracy of a plan
result         the estimate
"""
