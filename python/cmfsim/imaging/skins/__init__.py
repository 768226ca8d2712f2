"""The skin in a scan: outer surface, hollows inside, things that lie on it."""
