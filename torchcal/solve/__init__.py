"""Batched robust least squares."""
