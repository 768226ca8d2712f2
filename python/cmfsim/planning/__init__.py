"""Planning: new plans at once, measures of the face, plans for a desired face, and the page."""
