"""What pulse jitter does to an average: exact moments, laws of the amplitude, design."""
