"""Low-level reading of MCAP files: complete records only; whatever is inconsistent is rejected."""
