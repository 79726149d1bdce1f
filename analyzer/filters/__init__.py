"""The filter language: reads, checks and completes filters; lets rows through, changes none."""
