"""From keyphasor to angle: pulse detection, pulse validation, angle laws, resampling."""
