"""Look at the built site as a reader would: links, images, notebooks, search, phone width.

    python docs/check_site.py docs/_build/html

What needs a browser (headless Chromium, if there is one) is told as skipped without it. The
network is not used. The exit status is 1 if anything is wrong.
"""

import argparse
import ast
import json
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
WORDS = ("MOESP", "Floquet", "trim", "wingbeat")  # that the search must find, stems of themselves
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
PHONE = 390  # pixels
SECONDS = 300  # for the browser to answer
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--no-first-run",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    "--remote-debugging-port=0",
)
READER = """<!doctype html><meta charset="utf-8"><body><script>
const asked = JSON.parse(decodeURIComponent(location.hash.slice(1)));
const frame = document.createElement("iframe");
frame.style = `border: 0; width: ${asked.width}px; height: 844px`;
document.body.append(frame);
const pause = ms => new Promise(done => setTimeout(done, ms));
function open_(url) {
  return new Promise(done => { frame.onload = done; frame.src = url; });
}
function wide(root) {  // what sticks out, but for code, tables and the like that scroll themselves
  const text = root.querySelector(".bd-article-container") || root.querySelector("body");
  const held = node => {
    for (let up = node.parentElement; up && up !== text; up = up.parentElement)
      if (frame.contentWindow.getComputedStyle(up).overflowX !== "visible") return true;
    return false;
  };
  const limit = Math.min(root.clientWidth, text.getBoundingClientRect().right);
  const found = [...text.querySelectorAll("*")]
    .filter(node => node.getBoundingClientRect().right > limit + 1 && !held(node));
  return {
    scroll: Math.max(root.scrollWidth, root.clientWidth + text.scrollWidth - text.clientWidth),
    wide: found.slice(0, 3).map(node => node.outerHTML.replace(/\\s+/g, " ").slice(0, 100)),
  };
}
async function equations(root) {  // those that MathJax has not set, or has set as an error
  const jax = frame.contentWindow.MathJax;
  if (jax && jax.startup) await jax.startup.promise;
  const unset = [...root.querySelectorAll(".math")].filter(node => !node.querySelector("svg"));
  const wrong = [...root.querySelectorAll("[data-mjx-error]")];
  return [...unset.map(node => node.textContent.slice(0, 60)),
          ...wrong.map(node => node.getAttribute("data-mjx-error"))];
}
async function look(page) {
  await open_("/" + page);
  const root = frame.contentDocument.documentElement, unset = await equations(root);
  const images = [...root.querySelectorAll("img")];
  images.forEach(image => { image.loading = "eager"; });
  await Promise.all(images.map(image => image.decode().catch(() => null)));
  const own = images.filter(image => image.src.startsWith(location.origin));
  return {
    page, width: root.clientWidth, ...wide(root), unset,
    blank: own.filter(image => !image.naturalWidth).map(image => image.getAttribute("src")),
  };
}
async function search(word) {
  await open_("/search.html?q=" + word);
  for (let wait = 0; wait < 100; wait++) {
    const found = frame.contentDocument.querySelectorAll("#search-results ul li");
    if (found.length) return found.length;
    await pause(100);
  }
  return 0;
}
(async () => {
  const report = {pages: [], hits: {}};
  for (const page of asked.pages) report.pages.push(await look(page));
  for (const word of asked.words) report.hits[word] = await search(word);
  fetch("/report", {method: "POST", body: JSON.stringify(report)});
})();
</script>"""


class Page(HTMLParser):
    """Anchors of a page, and what it links to."""

    def __init__(self, text):
        super().__init__()
        self.anchors, self.links = set(), set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = {name: value for name, value in attrs if value}
        self.anchors |= {attrs[name] for name in ("id", "name") if name in attrs}
        self.links |= {attrs[name] for name in ("href", "src") if name in attrs}
        for part in attrs.get("srcset", "").split(","):
            self.links |= set(part.split()[:1])


# ---- without a browser ------------------------------------------------------------------------


def pages_of(site):
    """All pages but the theme's templates."""
    return sorted(path for path in site.rglob("*.html") if site / "_static" not in path.parents)


def broken_links(site):
    """Links of all pages to files and anchors that are not there."""
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in pages_of(site)}
    wrong = []
    for path, page in pages.items():
        for link in sorted(page.links):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or link == "#":
                continue
            base = site if parts.path.startswith("/") else path.parent
            target = (base / unquote(parts.path).lstrip("/")).resolve() if parts.path else path
            anchor = unquote(parts.fragment)
            if not target.exists():
                wrong.append(f"{path.relative_to(site)}: nothing is at {link}")
            elif anchor and target in pages and anchor not in pages[target].anchors:
                wrong.append(f"{path.relative_to(site)}: no anchor {link}")
    return wrong


def missing_thumbnails(site, examples=EXAMPLES):
    """Examples without a picture of their own on the gallery's page."""
    index = site / "auto_examples" / "index.html"
    if not index.exists():
        return ["there is no gallery: auto_examples/index.html"]
    shown = {link for link in Page(index.read_text(encoding="utf-8")).links if "thumb" in link}
    wrong = []
    for example in sorted(examples.glob("plot_*.py")):
        name = f"sphx_glr_{example.stem}_thumb.png"
        if not any(link.endswith(name) for link in shown):
            wrong.append(f"auto_examples/index.html: no thumbnail of {example.name}")
    return wrong


def wrong_notebooks(site, examples=EXAMPLES):
    """Examples whose page offers no notebook, or one with other code than the script."""
    wrong = []
    for example in sorted(examples.glob("plot_*.py")):
        page = site / "auto_examples" / f"{example.stem}.html"
        links = Page(page.read_text(encoding="utf-8")).links if page.exists() else ()
        link = next((link for link in links if link.endswith(f"{example.stem}.ipynb")), None)
        if not link or not (file := (page.parent / link)).exists():
            wrong.append(f"auto_examples/{example.stem}.html: no notebook")
            continue
        cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
        code = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code")
        script = ast.parse(example.read_text(encoding="utf-8"))
        script.body = script.body[1:]  # the docstring is the text of the first cell
        if ast.dump(ast.parse(code)) != ast.dump(script):
            wrong.append(f"{file.name}: other code than {example.name}")
    return wrong


def missing_words(site, words=WORDS):
    """Words that the search index does not know, or knows in pages that are not there."""
    file = site / "searchindex.js"
    if not file.exists():
        return ["there is no search index: searchindex.js"]
    index = json.loads(re.fullmatch(r"Search\.setIndex\((.*)\);?\s*", file.read_text())[1])
    wrong = []
    for word in words:
        found = [index[part].get(word.lower(), []) for part in ("terms", "titleterms")]
        pages = {k for hits in found for k in (hits if isinstance(hits, list) else [hits])}
        if not pages:
            wrong.append(f"searchindex.js: {word!r} is not found")
    wrong += [
        f"searchindex.js: page {name!r} is not there"
        for name in index["docnames"]
        if not (site / f"{name}.html").exists()
    ]
    return wrong


# ---- with a browser ---------------------------------------------------------------------------


class Handler(SimpleHTTPRequestHandler):
    """The site, a page that reads it, and the place where that page reports."""

    def do_GET(self):
        if self.path != "/reader":
            with suppress(ConnectionError):  # the browser has gone on to the next page
                super().do_GET()
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.end_headers()
        self.wfile.write(READER.encode())

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(204)
        self.end_headers()
        self.server.report = json.loads(body)
        self.server.reported.set()

    def log_message(self, *_):
        """Say nothing: the report is what counts."""


def seen(site, browser, width=PHONE, words=WORDS):
    """What a browser sees: width of each page, blank images, hits of the search.

    Nothing if it ends before it has answered, as one does that cannot run on this machine.
    """
    pages = [path.relative_to(site).as_posix() for path in pages_of(site)]
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=site))
    server.report, server.reported = None, threading.Event()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    asked = json.dumps({"pages": pages, "words": words, "width": width})
    url = f"http://127.0.0.1:{server.server_port}/reader#{asked}"
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [browser, *FLAGS, f"--user-data-dir={profile}", url]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(command, **silent) as process:
            last = time.monotonic() + SECONDS
            while not server.reported.wait(0.2) and process.poll() is None:
                if time.monotonic() > last:
                    process.kill()
                    raise TimeoutError(f"{browser} has not answered within {SECONDS} s")
            process.terminate()
    server.shutdown()
    return server.report


def wrong_to_the_eye(report):
    """Pages wider than the screen, blank images, equations not set, searches without a hit."""
    wrong = []
    for page in report["pages"]:
        if page["scroll"] > page["width"]:
            what = f"{page['scroll']} px wide on a screen of {page['width']} px"
            wrong.append(f"{page['page']}: {what}: {'; '.join(page['wide'])}")
        wrong += [f"{page['page']}: image {source} is blank" for source in page["blank"]]
        wrong += [f"{page['page']}: equation not set: {which}" for which in page["unset"]]
    wrong += [f"search: no hit for {word!r}" for word, count in report["hits"].items() if not count]
    return wrong


# ---- main -------------------------------------------------------------------------------------


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("site", type=Path, nargs="?", default=Path("docs/_build/html"))
    parser.add_argument("--browser", help="Chromium; looked for on the path by default")
    arguments = parser.parse_args()
    site = arguments.site.resolve()
    wrong = broken_links(site) + missing_thumbnails(site) + wrong_notebooks(site)
    wrong += missing_words(site)
    browser = arguments.browser or next(filter(None, map(shutil.which, BROWSERS)), None)
    report = browser and seen(site, browser)
    if report:
        print(f"{len(report['pages'])} pages opened at {PHONE} px; hits: {report['hits']}")
        wrong += wrong_to_the_eye(report)
    else:
        why = f"{browser} does not run" if browser else "no Chromium found"
        print(f"skipped, as {why}: phone width, images and equations as shown, search as typed")
    print("\n".join(wrong) or "nothing is wrong with the site")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
