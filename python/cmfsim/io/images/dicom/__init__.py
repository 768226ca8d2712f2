"""DICOM: headers, slices, and the series that they make up."""
