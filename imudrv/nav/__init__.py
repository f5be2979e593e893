"""Strapdown mathematics, pure: no files, no clock, no settings; kernels that live and offline code share.

attitude       rotations
earth          WGS-84: gravity, rotation, radii
alignment      attitude of a unit that stands still
mechanisation  navigation, and how it answers to what is left in the increments: H, B, P, Q
size_effect    the size effect as numpy formulas
"""
