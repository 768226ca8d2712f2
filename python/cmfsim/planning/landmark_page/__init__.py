"""The page of landmarks: one HTML file in which they are checked, placed and saved."""

from cmfsim.planning.landmark_page.page import (
    LandmarkContent,
    PageSite,
    landmark_content,
    landmark_page_text,
)

__all__ = ["LandmarkContent", "PageSite", "landmark_content", "landmark_page_text"]
