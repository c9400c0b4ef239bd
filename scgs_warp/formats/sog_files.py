"""The files of a SOG: a description and images, in a folder or in an uncompressed zip archive (``.sog``)."""

from __future__ import annotations

import io
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np

from ..errors import UserError
from ..storage.files import new_beside, read_bytes, write_and_flush, write_atomically
from ..storage.output_folders import check_replaceable, make_parent, replace_folder
from ..storage.safe_paths import inside

META = "meta.json"
SUFFIX = ".sog"
IMAGES = ("means_l", "means_u", "scales", "quats", "sh0", "shN_centroids", "shN_labels")
MAX_META = 1 << 22
"""Largest description, bytes."""
MAX_PIXELS = 1 << 24
"""Largest image, pixels: room for 16 million Gaussians."""
MAX_IMAGE = 4 * MAX_PIXELS + (1 << 16)
"""Largest image file, bytes: that of pixels that cannot be compressed."""
KINDS = ["WEBP", "PNG"]
"""Formats of images that are read."""
DAMAGE = (
    OSError,
    ValueError,
    SyntaxError,
    EOFError,
    KeyError,
    IndexError,
    OverflowError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What a damaged archive or image may raise."""
REMEDY = "export it again"


class SogFiles:
    """Files of one SOG, to be read by name; an archive is never unpacked to the disk."""

    def __init__(self, path: Path) -> None:
        """Open a ``.sog``, a ``meta.json`` or the folder that holds one.

        Raises:
            UserError: it is missing or no archive.
        """
        self.path = path / META if path.is_dir() else path
        self.archive: zipfile.ZipFile | None = None
        if self.path.suffix.lower() == SUFFIX:
            try:
                self.archive = zipfile.ZipFile(io.BytesIO(read_bytes(self.path, "give a .sog")))
            except DAMAGE:
                raise UserError(f"{self.path}: no zip archive, or damaged; {REMEDY}") from None

    def meta(self) -> bytes:
        """Return the description."""
        return self._read(META if self.archive is not None else self.path.name, MAX_META)

    def image(self, name: str, least: int) -> np.ndarray:
        """Return an image as [H, W, 4] uint8.

        Args:
            least: pixels that it must have.

        Raises:
            UserError: the name leads out of the folder, or the image is missing, damaged, too large or too small.
        """
        from PIL import Image

        content = self._read(name, MAX_IMAGE)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # The size is checked below.
                with Image.open(io.BytesIO(content), formats=KINDS) as image:
                    width, height = image.size
                    if least <= width * height <= MAX_PIXELS:
                        return np.asarray(image.convert("RGBA"))
        except (*DAMAGE, MemoryError, Image.DecompressionBombError) as error:
            raise UserError(f"{self.path}: {name} is no sound WebP or PNG ({type(error).__name__}); {REMEDY}") from None
        raise UserError(
            f"{self.path}: {name} has {width} x {height} pixels; it needs {least:,} to {MAX_PIXELS:,}: {REMEDY}"
        )

    def _read(self, name: str, most: int) -> bytes:
        """Return the content of a file of at most ``most`` bytes."""
        if self.archive is None:
            path = self.path if name == self.path.name else inside(self.path.parent, name, f"{self.path}: files")
            if path.is_file() and path.stat().st_size > most:
                raise UserError(f"{path}: has {path.stat().st_size:,} bytes; at most {most:,} are read: {REMEDY}")
            return read_bytes(path, "restore it, or give a .sog or the meta.json of one")
        try:
            info = self.archive.getinfo(name)
        except KeyError:
            raise UserError(f"{self.path}: holds no {name[:60]!r}; {REMEDY}") from None
        if info.file_size > most or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise UserError(f"{self.path}: {name[:60]!r} is larger than {most:,} bytes, or of another kind; {REMEDY}")
        try:
            with self.archive.open(info) as file:
                content = file.read(most + 1)
        except DAMAGE as error:
            raise UserError(f"{self.path}: {name[:60]!r} is damaged ({type(error).__name__}); {REMEDY}") from None
        if len(content) != info.file_size:
            raise UserError(f"{self.path}: {name[:60]!r} is cut short; {REMEDY}")
        return content


def encode_image(path: Path, pixels: np.ndarray) -> bytes:
    """Return pixels [H, W, 4] uint8 as lossless WebP; colours of transparent pixels are kept.

    Args:
        path: file to be written, for the message.

    Raises:
        UserError: this Pillow cannot write WebP.
    """
    from PIL import Image, features

    if not features.check("webp"):
        raise UserError(f"{path}: a SOG holds WebP images, which this Pillow lacks; pip install --upgrade pillow")
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True, quality=75, method=4)
    return stream.getvalue()


def write_files(path: Path, files: dict[str, bytes]) -> None:
    """Write files by name, once all are complete: into an archive if the path ends in .sog, else into the folder of the
    path, which ends in meta.json. The folder is replaced as a whole.

    Raises:
        UserError: the folder holds other files, or cannot be written.
    """
    make_parent(path)
    if path.name.lower() != META:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
            for name, content in files.items():
                archive.writestr(zipfile.ZipInfo(name), content)  # without the time: the same files, the same bytes
        write_atomically(path, stream.getvalue())
        return
    folder = check_folder(path)
    try:
        with new_beside(folder, folder=True) as temporary:
            for name, content in files.items():
                write_and_flush(temporary / name, content)
            replace_folder(folder, temporary)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror}); give another folder") from None


def check_folder(path: Path) -> Path:
    """Check that the folder of a ``meta.json`` may be replaced, as :func:`check_replaceable`."""
    names = rf"{META.replace('.', '[.]')}|({'|'.join(IMAGES)})[.]webp"
    return check_replaceable(path.parent, names, f"{META} and its images")
