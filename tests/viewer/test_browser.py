"""Messages of a page: all its errors, and none about the driver's speed."""

from types import SimpleNamespace

import pytest
from helpers.browser import complains

DRIVER = "[.WebGL-0x187c0017f600]GL Driver Message (OpenGL, "
PAGE = """<canvas></canvas><script>
const gl = document.querySelector("canvas").getContext("webgl2");
const pixels = new Uint8Array(4 << 12);
for (let i = 0; i < 200; i++) {
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.readPixels(0, 0, 64, 64, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
}
gl.enable(1);
console.warn("GL Driver Message (OpenGL, Performance, as the page says it");
new Image().src = "none.png";
setTimeout(() => { throw new Error("thrown"); }, 300);
</script>"""
WANTED = ("INVALID_ENUM: enable", "as the page says it", "Failed to load resource", "thrown")


def test_what_a_page_complains_of_is_heard(browser_page, tmp_path):
    (tmp_path / "a.html").write_text(PAGE)
    opened = browser_page(tmp_path / "a.html")
    opened.page.wait_for_timeout(1000)
    for part in WANTED:
        assert [text for text in opened.messages if part in text], part
    assert len(opened.messages) == len(WANTED), opened.messages


@pytest.mark.parametrize(
    "kind, text, said, wanted",
    [
        ("warning", f"{DRIVER}Performance, GL_CLOSE_PATH_NV, High): GPU stall", [], False),
        ("warning", f"{DRIVER}Performance, GL_CLOSE_PATH_NV, High): GPU stall", ["it"], True),
        ("warning", f"{DRIVER}Error, GL_INVALID_OPERATION, High): no program", [], True),
        ("error", f"{DRIVER}Performance, GL_CLOSE_PATH_NV, High): GPU stall", [], True),
        ("warning", "WebGL: INVALID_ENUM: enable: invalid capability", [], True),
        ("log", "hello", ["hello"], False),
    ],
)
def test_a_driver_that_speaks_of_its_speed_is_not(kind, text, said, wanted):
    """Browsers that draw in software pass on such messages, some of them and sometimes."""
    assert complains(SimpleNamespace(type=kind, text=text, args=said)) == wanted
