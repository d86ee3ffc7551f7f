"""Measuring speed: of the whole service and of its stages."""
