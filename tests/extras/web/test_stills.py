"""The list of stills shows which objects each line is about."""

import json
from pathlib import Path

import hvt_web
from programs.node import needs_node, ran

STILLS = Path(hvt_web.__file__).parent / "static" / "stills.js"


@needs_node
def test_each_object_of_a_line_is_outlined():
    """Of two cars of which the same is to be said the second was nowhere: the line seemed to be about the first."""
    lines, said = ran(f"""
      const within = (one) => one.children.flatMap((child) => [child, ...within(child)]);
      const element = (kind) => {{
        const one = {{ kind, dataset: {{}}, children: [], addEventListener() {{}}, contains: () => false }};
        const take = (child) => (one.children.push(child), child);
        const all = (kind) => within(one).filter((child) => child.kind === kind);
        one.replaceChildren = () => (one.children = []);
        return Object.assign(one, {{ append: take, appendChild: take, prepend: take, querySelectorAll: all,
          setAttribute: (name, value) => {{ one[name] = value; }} }});
      }};
      globalThis.document = {{ createElement: element, createElementNS: (_, kind) => element(kind) }};
      const {{ Stills }} = await import({json.dumps(STILLS.as_uri())});
      const list = element("ol");
      const stills = new Stills(list, element("dialog"));
      const still = {{ id: "1", captured: 0, shows: ["still"], crop: [0, 0, 9, 9], track: 7, after: "car" }};
      for (const x of [1, 5]) stills.add({{ ...still, box: [x, 2, x + 3, 4] }});
      const lines = list.children.map((line) => line.querySelectorAll("rect").map((one) => [one.x, one.width]));
      stills.outdate();
      console.log(JSON.stringify([lines, within(list).map((one) => one.textContent).find(Boolean)]));
    """)
    assert lines == [[["1", "3"], ["5", "3"]]]
    assert said.startswith("track 7 of the flight before: "), "another flight has a track 7 of its own"
