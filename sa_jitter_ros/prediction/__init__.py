"""What pulse jitter does to an average: exact moments, distributions of the amplitude, design."""
