"""Files of kinds that other programs got wrong, by public reports: what they say is used, or refused in one line."""
