"""Planning: new plans at once, measures of the face, plans for a wished face, and the page."""
