"""Occlusion: how the tooth rows meet before and after the operation, and splints between them."""
