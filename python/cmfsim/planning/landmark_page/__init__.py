"""The page of landmarks: one HTML file in which they are checked, placed and saved."""

from cmfsim.planning.landmark_page.page import PageSite as PageSite
from cmfsim.planning.landmark_page.page import landmark_content as landmark_content
from cmfsim.planning.landmark_page.page import landmark_page_text as landmark_page_text
