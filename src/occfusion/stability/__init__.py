"""Stiff and extreme cases, swept: error of value and gradient against float64 oracles that share no code, and time."""
