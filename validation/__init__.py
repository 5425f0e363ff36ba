"""Reproduction of Camerini et al. 2019, one module per group of its results."""
