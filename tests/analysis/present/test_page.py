"""The page: complete, true to the numbers, escaped, reachable, without outside references."""

import base64
import dataclasses
import hashlib
import math
import re
from html.parser import HTMLParser
from itertools import pairwise

import pytest

from undulog.analysis import Estimate
from undulog.analysis.present.page import render
from undulog.analysis.results.coupling import Coupling

pytestmark = pytest.mark.slow

VOID = {"meta", "link", "br", "hr", "img", "input"}
NAMES = ["snake", "still", "single", "hostile"]


class Node:
    def __init__(self, tag, attributes, parent):
        self.tag, self.attributes, self.parent = tag, attributes, parent
        self.children = []

    def text(self):
        return "".join(c if isinstance(c, str) else c.text() for c in self.children)

    def all(self, *tags):
        for child in self.children:
            if not isinstance(child, str):
                if not tags or child.tag in tags:
                    yield child
                yield from child.all(*tags)


class Tree(HTMLParser):
    def __init__(self, page):
        super().__init__(convert_charrefs=True)
        self.root = self.here = Node("", {}, None)
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        node = Node(tag, dict(attrs), self.here)
        self.here.children.append(node)
        if tag not in VOID:
            self.here = node

    def handle_startendtag(self, tag, attrs):
        self.here.children.append(Node(tag, dict(attrs), self.here))

    def handle_endtag(self, tag):
        assert tag == self.here.tag, f"</{tag}> closes <{self.here.tag}>"
        self.here = self.here.parent

    def handle_data(self, data):
        self.here.children.append(data)


def tree(page):
    parsed = Tree(page)
    assert parsed.here is parsed.root, "an element is left open"
    return parsed.root


@pytest.fixture(scope="module", params=NAMES)
def page(request):
    return render(request.getfixturevalue(request.param))


@pytest.fixture(scope="module")
def snake_page(snake):
    return render(snake)


def rows(root, table):
    node = next(t for t in root.all("table") if t.attributes.get("class") == table)
    return [list(row.all("td", "th")) for row in node.all("tr")]


def numbers(cell):
    return [float(d.attributes["value"]) for d in cell.all("data")]


def test_nothing_is_fetched_from_outside(page):
    root = tree(page)
    for node in root.all():
        assert node.tag not in ("iframe", "img", "object", "embed", "base", "form")
        for key, value in node.attributes.items():
            assert not key.startswith("on"), f"{node.tag} {key}"
            if key in ("src", "href", "xlink:href", "srcset", "action", "data"):
                assert value.startswith("#") or value == "data:,", f"{node.tag} {key}={value}"
            if key == "style":
                assert re.findall(r"url\((?!#)", value) == []
    for style in root.all("style"):
        assert re.findall(r"@import|url\(|http", style.text()) == []
    (script,) = root.all("script")
    assert script.attributes == {}
    assert "://" not in script.text()


def test_the_policy_allows_the_one_script_and_nothing_else(page):
    root = tree(page)
    (policy,) = (n.attributes["content"] for n in root.all("meta") if "http-equiv" in n.attributes)
    (script,) = root.all("script")
    digest = base64.b64encode(hashlib.sha256(script.text().encode()).digest()).decode()
    rules = [rule.split() for rule in policy.split(";")]
    assert ["default-src", "'none'"] in rules
    assert ["script-src", f"'sha256-{digest}'"] in rules
    assert len(script.text()) < 16_000


def test_identifiers_are_unique_and_every_anchor_lands(page):
    root = tree(page)
    ids = [n.attributes["id"] for n in root.all() if "id" in n.attributes]
    assert len(ids) == len(set(ids))
    targets = [n.attributes["href"] for n in root.all("a")]
    for node in root.all("section", "article", "svg"):
        label = node.attributes.get("aria-labelledby")
        targets += [f"#{label}"] if label else []
        assert label or node.attributes.get("aria-label") or "aria-hidden" in node.attributes
    assert all(target[1:] in ids for target in targets)


def test_svgs_have_titles_tables_have_captions_headings_have_order(page):
    root = tree(page)
    for drawing in root.all("svg"):
        assert drawing.attributes["role"] in ("img", "group")
        first = drawing.children[0]
        assert first.tag == "title"
        assert first.text().strip()
    for table in root.all("table"):
        caption = table.children[1]
        assert caption.tag == "caption", "the caption stands first in its table"
        assert caption.text().strip()
        assert all(h.attributes.get("scope") in ("col", "row") for h in table.all("th"))
    levels = [int(h.tag[1]) for h in root.all("h1", "h2", "h3", "h4", "h5", "h6")]
    assert (levels.count(1), levels[0]) == (1, 1)
    assert all(after <= before + 1 for before, after in pairwise(levels))
    assert next(root.all("html")).attributes["lang"] == "en"
    assert len(list(root.all("main"))) == 1


def test_what_scrolls_can_be_reached_by_the_keyboard(page):
    for node in tree(page).all("div", "pre"):
        if node.attributes.get("class") == "wide" or node.tag == "pre":
            assert node.attributes["tabindex"] == "0"


def test_headings_and_reason_of_a_missing_coupling(snake_page):
    root = tree(snake_page)
    headings = [h.text() for h in root.all("h1", "h2", "h3")]
    assert headings[0].startswith("The segments do not move alike")
    text = next(root.all("main")).text()
    why = "Coupling: not identifiable from this session. One gait gives 13 numbers"
    assert all(part in text for part in (why, "undulog plan phase-kicks"))


def test_question_answer_evidence_limits_and_method_stand_in_this_order(page):
    main = next(tree(page).all("main"))
    parts = [
        section.attributes.get("aria-label") or next(section.all("h2")).text()
        for section in main.children
        if not isinstance(section, str) and section.tag == "section"
    ]
    assert parts == ["Question", "Answer", "Evidence", "Limits", "Method"]


def test_no_sentence_of_the_page_is_printed_twice(page):
    main = next(tree(page).all("main"))
    texts = [node.text().strip() for node in main.all("p", "li", "figcaption", "caption")]
    whole = [text for text in texts if len(text.split()) > 5 and "\n" not in text]
    assert sorted(whole) == sorted(set(whole))


def test_numbers_of_the_joints_are_those_of_the_analysis(snake, snake_page):
    head, *body = rows(tree(snake_page), "joints")
    title = [cell.text() for cell in head]
    assert len(body) == len(snake.joints) == 25
    for joint, row in zip(snake.joints, body, strict=True):
        cell = dict(zip(title, row, strict=True))
        assert (cell["joint"].text(), cell["plane"].text()) == (joint.name, joint.plane)
        assert cell["flags"].text() == ", ".join(joint.flags)
        assert cell["samples"].text() == str(joint.samples)
        for name, quantity, scale in (
            ("gain [1]", joint.gain, 1.0),
            ("lag [°]", joint.lag_rad, 180 / math.pi),
            ("command [°]", Estimate(joint.command_amplitude_rad), 180 / math.pi),
            ("coverage [%]", Estimate(joint.coverage), 100.0),
        ):
            values = [] if quantity.value is None else [quantity.value, *(quantity.ci95 or ())]
            assert numbers(cell[name]) == pytest.approx([v * scale for v in values], rel=1e-12)
            if not values:
                assert "–" in cell[name].text()
            for shown in cell[name].all("data"):  # what is read is what is stored, rounded
                read, stored = shown.text().replace("−", "-"), float(shown.attributes["value"])
                room = 0.51 * 10 ** -len(read.partition(".")[2])
                assert float(read) == pytest.approx(stored, abs=room)


def test_energies_are_those_of_the_analysis(snake, snake_page):
    head, *body = rows(tree(snake_page), "energies")
    ends = ("net", "plus", "abs", "el", "el+")
    assert [c.text() for c in head[2:]] == [f"E_{end} [J]" for end in ends]
    for joint, row in zip(snake.joints, body, strict=True):
        names = ("net", "plus", "abs", "el", "el_clipped")
        energies = [getattr(joint, f"energy_{name}_j") for name in names]
        assert [numbers(c) for c in row[2:]] == [[] if e is None else [e] for e in energies]


def test_indices_and_body_are_those_of_the_analysis(snake, snake_page):
    root = tree(snake_page)
    _, *body = rows(root, "indices")
    for (name, index), row in zip(snake.heterogeneity.items(), body, strict=True):
        scale = 180 / math.pi if index.unit == "rad" else 1.0
        assert (row[0].text(), row[1].text()) == (name, index.label)
        assert numbers(row[2]) == pytest.approx([index.value * scale])
        assert numbers(row[3]) == pytest.approx([v * scale for v in index.ci95 or ()])
        assert numbers(row[4]) == ([] if index.p is None else [index.p])
    _, *body = rows(root, "body")
    assert len(body) == 6  # three places, each with its null
    head, head_null = body[0], body[1]
    assert numbers(head[3])[0] == pytest.approx(52.0)
    assert head_null[2].text() == "perfect tracking, viscous"
    assert numbers(head_null[3]) == pytest.approx([55.0])


def test_provenance_is_complete(snake, snake_page):
    root = tree(snake_page)
    shown = {row[1].text(): row[2].text() for row in rows(root, "provenance")[1:]}
    made = snake.provenance
    assert shown["weak.mcap"] == made.inputs["weak.mcap"]
    assert (shown["numpy"], shown["harmonics"]) == (made.versions["numpy"], "1")
    assert "–" in shown["settle_s"]
    commands = "undulog analyse weak.mcap\nundulog report weak.mcap -o report.html"
    assert next(root.all("pre")).text().rstrip("\n") == commands


def test_every_warning_is_shown(snake, still):
    for analysis in (snake, still):
        root = tree(render(analysis))
        lead = next(p for p in root.all("p") if p.attributes.get("class") == "lead")
        items = [li.text() for li in root.all("li")]
        assert all((w in items) != (w in lead.text()) for w in analysis.warnings)


def test_nulls_are_dashes_never_zeros(still):
    root = tree(render(still))
    for row in rows(root, "joints")[1:]:
        for cell in row[3:6]:
            assert cell.text().startswith("–")
            assert "not computed" in cell.text()
    assert not list(root.all("svg"))


def test_hostile_names_stay_text(hostile):
    page = render(hostile)
    assert page.count("<script") == page.count("<script>(") == 1
    assert "\x00" not in page
    shown = [row[1].text() for row in rows(tree(page), "joints")[1:]]
    assert shown[0].startswith("<script>alert('x')</script>$")
    assert shown[0].endswith("蛇joint01")


def test_the_page_is_small_and_the_same_for_the_same_input(snake, snake_page):
    assert render(snake) == snake_page
    assert len(snake_page.encode()) < 300_000


def test_coupling_that_was_identified_is_drawn_and_listed(single):
    matrix = ((0.8, -0.2), (0.1, 0.9))
    coupling = Coupling(True, "local kicks around one gait", None, matrix, 3.4)
    root = tree(render(dataclasses.replace(single, coupling=coupling)))
    shown = [[numbers(cell)[0] for cell in row[1:]] for row in rows(root, "coupling")[1:]]
    assert shown == [list(row) for row in matrix]
    assert "Coupling: response over command" in [s.children[0].text() for s in root.all("svg")]
    assert "Identifiable, condition number 3.4. Local kicks" in next(root.all("main")).text()
