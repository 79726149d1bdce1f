"""Listeners of a run: journal, meter, recorder, wire log."""
