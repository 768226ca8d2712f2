"""New plans for a patient who is built: by one small product, or solved exactly."""
