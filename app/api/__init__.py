"""One router per resource; ``deps`` and ``bodies`` hold what they share."""
