"""Segmentation files as others write them: slicerio, SimpleITK, nibabel, highdicom."""

import numpy as np
import pytest

from estimator.segmentation.drawn import Grid

LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
TYPES = {
    "liver": ("Tissue", "Liver", (0.87, 0.72, 0.55)),
    "portal vein": ("Tissue", "Portal vein", (0.0, 0.59, 0.81)),
    "tumor 1": ("Morphologically Altered Structure", "Mass", (0.56, 0.93, 0.56)),
    "spleen": ("Tissue", "Spleen", (0.61, 0.42, 0.53)),
}


def write_slicerio(path, masks, where: Grid):
    """`.seg.nrrd` by the library of 3D Slicer's makers; overlapping segments come into several layers."""
    slicerio = pytest.importorskip("slicerio", reason="slicerio is not installed")
    found = slicerio.create_segmentation(where.shape, where.affine)
    for number, (name, mask) in enumerate(masks.items()):
        category, kind, colour = TYPES.get(name, ("Tissue", "Tissue", (0.5, 0.5, 0.5)))
        terminology = {
            "contextName": "Segmentation category and type - 3D Slicer General Anatomy list",
            "category": ["SCT", "1", category],
            "type": ["SCT", "2", kind],
        }
        about = {"id": f"Segment_{number}", "name": name, "color": list(colour), "terminology": terminology}
        slicerio.add_segment(found, mask, about)
    slicerio.write_segmentation(str(path), found, compression_level=1)
    return found["voxels"].shape


def write_itk(path, labels, where: Grid):
    """NRRD or NIfTI by ITK, which keeps directions as cosines."""
    sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    image = sitk.GetImageFromArray(labels.transpose(2, 1, 0))
    spacing = np.linalg.norm(where.affine[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(where.affine[:3, 3].tolist())
    image.SetDirection((where.affine[:3, :3] / spacing).ravel().tolist())
    sitk.WriteImage(image, str(path), useCompression=True)


def write_nibabel(path, labels, where: Grid, sform=1, qform=0, unit="mm"):
    nibabel = pytest.importorskip("nibabel", reason="nibabel is not installed")
    affine = LPS_TO_RAS @ where.affine
    affine[:3] *= {"mm": 1.0, "meter": 1e-3, "micron": 1e3}[unit]
    image = nibabel.Nifti1Image(labels, affine)
    image.set_sform(affine if sform else None, code=sform)
    image.set_qform(affine if qform else None, code=qform)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return image


def write_highdicom(path, masks, where: Grid, kind="BINARY"):
    """DICOM SEG, of which highdicom leaves out frames without a voxel."""
    hd = pytest.importorskip("highdicom", reason="highdicom is not installed")
    from pydicom.sr.codedict import codes
    from pydicom.uid import generate_uid

    names = list(masks)
    descriptions = [
        hd.seg.SegmentDescription(
            segment_number=number,
            segment_label=name,
            segmented_property_category=codes.SCT.Tissue
            if "tumor" not in name
            else codes.SCT.MorphologicallyAbnormalStructure,
            segmented_property_type=codes.SCT.Liver if name == "liver" else codes.SCT.Vein,
            algorithm_type=hd.seg.SegmentAlgorithmTypeValues.MANUAL,
            display_color=hd.color.CIELabColor.from_rgb(*(int(255 * c) for c in TYPES[name][2])),
        )
        for number, name in enumerate(names, 1)
    ]
    # highdicom's volumes have their axes in the order slice, row, column.
    pixels = np.stack([masks[name].transpose(2, 1, 0) for name in names], axis=-1)
    if kind == "FRACTIONAL":
        pixels = pixels.astype(np.float32) * 0.9
    elif kind == "LABELMAP":
        pixels = (pixels * np.arange(1, len(names) + 1)).max(axis=-1)
    affine = where.affine[:, [2, 1, 0, 3]]
    volume = hd.Volume(
        pixels.astype(np.float32 if kind == "FRACTIONAL" else np.uint8),
        affine,
        coordinate_system="PATIENT",
        channels=None if kind == "LABELMAP" else {"SegmentNumber": list(range(1, len(names) + 1))},
    )
    source = _source(where, generate_uid)
    segmentation = hd.seg.Segmentation(
        source_images=source,
        pixel_array=volume,
        segmentation_type=kind,
        segment_descriptions=descriptions,
        series_instance_uid=generate_uid(),
        series_number=1,
        sop_instance_uid=generate_uid(),
        instance_number=1,
        manufacturer="test",
        manufacturer_model_name="test",
        software_versions="1",
        device_serial_number="1",
    )
    segmentation.save_as(path)


def _source(where: Grid, generate_uid):
    """A CT of the same place, of which highdicom takes the patient and the study."""
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian

    spacing = np.linalg.norm(where.affine[:3, :3], axis=0)
    study, series, frame = (generate_uid() for _ in range(3))
    found = []
    for k in range(where.shape[2]):
        data = Dataset()
        data.file_meta = FileMetaDataset()
        data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        data.SOPClassUID, data.SOPInstanceUID = CTImageStorage, generate_uid()
        data.StudyInstanceUID, data.SeriesInstanceUID, data.FrameOfReferenceUID = study, series, frame
        data.PatientID = data.StudyID = data.AccessionNumber = "1"
        data.PatientName = "Doe^Jane"
        data.PatientBirthDate = data.PatientSex = data.StudyDate = data.StudyTime = ""
        data.ReferringPhysicianName = data.PositionReferenceIndicator = ""
        data.Modality, data.Manufacturer, data.SeriesNumber, data.InstanceNumber = "CT", "test", 1, k + 1
        data.Rows, data.Columns = where.shape[1], where.shape[0]
        data.PixelSpacing = [f"{spacing[1]:.6g}", f"{spacing[0]:.6g}"]
        data.SliceThickness = f"{spacing[2]:.6g}"
        directions = (where.affine[:3, :2] / spacing[:2]).T.ravel()
        data.ImageOrientationPatient = [f"{value:.10f}"[:16] for value in directions]
        place = where.affine[:3, 2] * k + where.affine[:3, 3]
        data.ImagePositionPatient = [f"{value:.10f}"[:16] for value in place]
        data.BitsAllocated = data.BitsStored = 16
        data.HighBit, data.SamplesPerPixel, data.PixelRepresentation = 15, 1, 0
        data.PhotometricInterpretation = "MONOCHROME2"
        found.append(data)
    return found
