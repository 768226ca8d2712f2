"""3D Slicer: scenes, transforms, and bundles for it."""
