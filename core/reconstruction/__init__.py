"""From counts or line integrals back to a volume, and scores of it."""
