"""Records of experiments: one, several, from files, from simulations, from public sources."""
