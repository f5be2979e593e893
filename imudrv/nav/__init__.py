"""Strapdown mathematics, pure: no files, no clock, no settings; kernels that live and offline code share.

attitude       rotations and quaternions
earth          WGS-84: gravity, rotation, radii
alignment      attitude of a unit at rest
noise          white noise and random walks from the variances of differences
mechanisation  navigation, and its response to residual errors of the increments: H, B, P, Q
"""
