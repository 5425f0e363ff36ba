"""From trigger cycles to averages: streaming averages, recovery of pulse errors, indicators."""
