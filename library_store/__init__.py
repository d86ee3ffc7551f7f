"""p(X | x): poses, cameras, the exemplar library and its nearest-neighbour index."""
