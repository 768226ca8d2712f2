"""From a scene to its solution, and from a patient's model to the face of one of four models."""
