"""What every room uses and no user: checks, files, workers, kernels, text for a terminal."""
