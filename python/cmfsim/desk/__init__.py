"""The desk: from a folder with a scan to a saved plan and its report, in the browser."""
