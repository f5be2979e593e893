"""Lever arms and their gauges.

gauge        sensing points with covariance, exact conversion of gauges
interchange  formats of Kalibr and PSINS
"""
