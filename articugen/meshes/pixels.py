"""Program: a picture on its input to a few raw pixels on its output.

Decoders of pictures have holes, and strangers' textures may be made for them: so it runs alone in a
process that has limits, of Pillow and the standard library, and imports nothing of ours.
"""

import io
import struct
import sys
from contextlib import suppress

UNREADABLE = 3
"""Its exit status where the input is no picture of FORMATS, or one of more than MOST_PIXELS."""
FORMATS = ("PNG", "JPEG", "BMP", "TGA", "WEBP")
MOST_PIXELS = 64_000_000
SIDE = 512  # pixels along an edge of what comes out, at most
MEMORY, SECONDS = 5 << 28, 20


def reduced(data: bytes) -> bytes:
    """Return width and height, and RGB pixels over white, each the mean of a box of the picture;
    raise whatever Pillow raises."""
    from PIL import Image, ImageChops  # noqa: PLC0415 - of the process that decodes alone

    with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
        if picture.width * picture.height > MOST_PIXELS:
            raise ValueError("too many pixels")
        whole = picture.convert("RGBA")
    small = whole.reduce(-(-max(whole.size) // SIDE)).convert("RGBa")  # times its opacity
    *colours, opacity = small.split()
    white = ImageChops.invert(opacity)
    flat = Image.merge("RGB", [ImageChops.add(colour, white) for colour in colours])
    return struct.pack("<II", *flat.size) + flat.tobytes()


if __name__ == "__main__":
    import resource

    import PIL.Image  # noqa: F401 - where it is missing, that is no fault of the picture

    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
    with suppress(ValueError):  # where a system knows no such limit
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    try:
        result = reduced(sys.stdin.buffer.read())
    except Exception:  # whatever a decoder meets
        sys.exit(UNREADABLE)
    sys.stdout.buffer.write(result)
