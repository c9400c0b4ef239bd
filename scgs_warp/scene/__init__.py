"""A trained scene: load, render, query."""
