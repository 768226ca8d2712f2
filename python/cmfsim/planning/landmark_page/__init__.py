"""The page of landmarks: one HTML file in which they are checked, placed and saved."""
