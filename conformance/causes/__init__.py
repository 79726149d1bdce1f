"""Names the causes of a run's failures: the fewest rules that set failed frames from right ones."""
