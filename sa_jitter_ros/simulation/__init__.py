"""Machines whose truth is known."""
