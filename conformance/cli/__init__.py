"""The suite's commands and the options they share."""
