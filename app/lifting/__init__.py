"""Lifting: 2D joints of a person to 3D by matching (eq. 4), camera (eq. 5) and warp (eq. 6)."""
