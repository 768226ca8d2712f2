"""What the module does, without Slicer: nothing here imports slicer, qt or ctk."""
