"""What runs in the browser: it covers the page when the viewer is silent, as after it has ended or while it hangs.

The page of viser itself leaves the last picture where it is. An old picture must not be taken for one of now.
"""

SILENT_S = 3.0
"""After which the page is covered."""

# The panel's elements exist while it is open alone: with it closed, nothing is heard and no status is said.
SCRIPT = f"""
if (!window.softtissueWatch) {{
  const add = (id, words, place) => {{
    const element = document.createElement("div");
    element.id = id;
    element.textContent = words;
    element.style.cssText = "position:fixed;z-index:100000;display:none;align-items:center;justify-content:center;"
      + "color:white;font:bold 20px sans-serif;text-align:center;" + place;
    document.body.append(element);
    return (shown) => {{ element.style.display = shown ? "flex" : "none"; }};
  }};
  const cover = add("softtissue-silent", "NO ESTIMATE: this page has heard nothing from the viewer for {SILENT_S:g} s",
    "inset:0;padding:10%;background:#2a0b09");
  const strip = add("softtissue-closed", "Panel closed: whether there is an estimate is said nowhere",
    "left:0;right:0;bottom:0;padding:10px;background:#a86400");
  let heard = "", since = performance.now();
  window.softtissueWatch = setInterval(() => {{
    const element = document.querySelector(".softtissue-beat");
    if (!element || element.dataset.beat !== heard) {{
      heard = element ? element.dataset.beat : "";
      since = performance.now();
    }}
    cover(performance.now() - since > {1e3 * SILENT_S:g});
    strip(!element);
  }}, 200);
}}
"""


def beat(number: int) -> str:
    """Return HTML that shows nothing; the script above hears it."""
    return f'<span class="softtissue-beat" data-beat="{number}"></span>'
