"""Executes cases over a link: preamble, stimulus, homing, retry, minimising, discovery."""
