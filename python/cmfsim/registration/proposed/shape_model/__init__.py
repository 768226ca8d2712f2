"""A model of the shape of heads, fitted to bone and skin as far as they are visible."""
