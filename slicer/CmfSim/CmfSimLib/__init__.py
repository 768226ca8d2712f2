"""The work of the module, without Slicer: nothing here imports slicer, qt or ctk."""
