"""Measured against predicted: observation, residual, effects, trace, report."""
