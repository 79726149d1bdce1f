"""Whether the looks of a probe that is not the kit's own can be believed."""
