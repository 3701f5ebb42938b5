"""The published network in plain dense forms: what tests compare with and benchmarks time."""
