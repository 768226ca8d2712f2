"""The VTK formats: legacy and XML, read and written."""
