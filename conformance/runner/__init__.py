"""Runs cases over a link: preamble, stimulus, homing, retry, minimising. Opens no port itself."""
