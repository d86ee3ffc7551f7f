"""Lifting: 2D joints of a person to 3D by matching (eq. 4), camera (eq. 5) and warp (eq. 6)."""

NEIGHBOURS = 200
"""Exemplars that are looked up for a person's fusion; the shortlist is the nearest of them."""
