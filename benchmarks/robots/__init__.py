"""Robots from an empty folder, each one script by the README's road."""
