"""The tests; the folders mirror the packages, `support` holds what they share."""
