"""The command line of the analyzer: its commands and the options they share."""
