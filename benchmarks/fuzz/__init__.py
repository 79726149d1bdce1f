"""Fuzzing: each reader of foreign bytes and text is fed seeded, damaged inputs, for no crash."""
