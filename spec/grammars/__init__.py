"""Grammars of published protocols, each one file of declarations with its document in front."""
