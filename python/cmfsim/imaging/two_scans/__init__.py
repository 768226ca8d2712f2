"""Registration of two scans of one head, and the skull that stays."""
