"""Commands for one patient: case, landmarks, plan, prediction, pictures."""
