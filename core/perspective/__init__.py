"""Views' own coordinates (u, v, k), what pairs of views know of each other, and what many of them say together."""
