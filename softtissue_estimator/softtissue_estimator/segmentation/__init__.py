"""Segmentations of scans: read from files of 3D Slicer, NIfTI and DICOM, and made into an organ folder."""
