"""Plane geometry: SE(2), angles, alignment and ellipses."""
