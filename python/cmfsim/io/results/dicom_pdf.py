"""A PDF as DICOM for the archive: an encapsulated document in the study of a CT (PS3.3, A.45.1)."""

from datetime import datetime
from pathlib import Path

from cmfsim._core import __version__
from cmfsim.errors import ImageInputError, third_party
from cmfsim.io.files.reading_writing import replacing
from cmfsim.io.images.dicom_series import dicom_files

# What is taken over from the CT: whose the document is, and to which study it belongs.
PATIENT = ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "SpecificCharacterSet")
STUDY = ("StudyInstanceUID", "StudyDate", "StudyTime", "StudyID", "AccessionNumber")
TAKEN = (*PATIENT, *STUDY, "ReferringPhysicianName")
SOP_CLASS = "1.2.840.10008.5.1.4.1.1.104.1"
# Behind the series of a scanner.
SERIES_NUMBER = 9001


def write_dicom_pdf(path: Path, pdf: bytes, source: Path, title: str) -> None:
    """Writes a PDF as a DICOM file of its own series in the study of a CT.

    source: The folder of the CT's series, or one file of it.
    Raises `CaseError`: pydicom is not installed.
    Raises `ImageError`: No DICOM, or that of several patients or studies.
    Raises `OSError`: A file cannot be read or written.
    """
    pydicom = third_party("pydicom", "DICOM is written", "imaging")
    uid = third_party("pydicom.uid", "DICOM is written", "imaging")
    found = {}
    for file in dicom_files(source) if source.is_dir() else [source]:
        try:
            header = pydicom.dcmread(file, stop_before_pixels=True, specific_tags=[*TAKEN])
        except pydicom.errors.InvalidDicomError:
            continue
        if "StudyInstanceUID" in header:
            found[str(header.get("PatientID", "")), str(header.StudyInstanceUID)] = header
    if len(found) != 1:
        raise ImageInputError(
            f"{source} holds DICOM of {len(found)} patients and studies (dicom-study): one is "
            "needed, of which the report is"
        )
    now = datetime.now().astimezone()
    data = pydicom.Dataset()
    data.SOPClassUID, data.SOPInstanceUID = SOP_CLASS, uid.generate_uid()
    for name in TAKEN:
        # Names of patients and studies must be there, even if they are empty.
        setattr(data, name, found[next(iter(found))].get(name, ""))
    if not data.SpecificCharacterSet:
        data.SpecificCharacterSet = "ISO_IR 192"
    data.Modality, data.SeriesInstanceUID = "DOC", uid.generate_uid()
    data.SeriesNumber, data.InstanceNumber = SERIES_NUMBER, 1
    data.SeriesDescription = data.DocumentTitle = title
    data.Manufacturer, data.SoftwareVersions = "cmfsim", __version__
    data.ConversionType, data.BurnedInAnnotation = "WSD", "YES"
    data.ContentDate, data.ContentTime = now.strftime("%Y%m%d"), now.strftime("%H%M%S")
    data.AcquisitionDateTime = ""
    data.ConceptNameCodeSequence = []
    data.MIMETypeOfEncapsulatedDocument = "application/pdf"
    data.EncapsulatedDocumentLength = len(pdf)
    # Values have an even length (PS3.5, 7.1).
    data.EncapsulatedDocument = pdf + b"\0" * (len(pdf) % 2)
    data.file_meta = pydicom.dataset.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = uid.ExplicitVRLittleEndian
    with replacing(path) as stream:
        pydicom.dcmwrite(stream, data, enforce_file_format=True)
