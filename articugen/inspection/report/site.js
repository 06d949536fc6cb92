
// A set on one page: objects are searched, opened beside each other, and linked to. The address holds
// which are open, and of each the joints' states and the camera: #object=…&joints=…&camera=…
(() => {
  const wall = document.querySelector(".wall");
  if (!wall) return;
  const tiles = [...wall.children];

  // --- all of them -----------------------------------------------------------------------------

  const choice = (title, names) =>
    node("select", { "aria-label": title }, ...names.map(([text, value]) => node("option", { value }, text)));
  const search = node("input", { type: "search", placeholder: "Search", "aria-label": "Search by id" });
  const splits = [...new Set(tiles.map((tile) => tile.dataset.split))];
  const split = choice("Split", [["All splits", ""], ...splits.map((name) => [name, name])]);
  const names = new Intl.Collator("en", { numeric: true });
  const orders = {
    "By name": (a, b) => names.compare(...[a, b].map((tile) => tile.querySelector("b").textContent)),
    "Largest first": (a, b) => b.dataset.size - a.dataset.size,
    "Smallest first": (a, b) => a.dataset.size - b.dataset.size,
    "Most joints first": (a, b) => b.dataset.joints - a.dataset.joints,
  };
  const order = choice("Order", Object.keys(orders).map((name) => [name, name]));
  const count = node("output", { className: "hint" });
  const arrange = () => {
    const wanted = search.value.trim().toLowerCase();
    for (const tile of tiles)
      tile.hidden = !tile.dataset.key.toLowerCase().includes(wanted) ||
        (split.value !== "" && tile.dataset.split !== split.value);
    wall.append(...tiles.sort(orders[order.value]));
    const left = tiles.filter((tile) => !tile.hidden).length;
    count.value = `${left.toLocaleString("en")} of ${tiles.length.toLocaleString("en")}`;
  };
  for (const field of [search, split, order]) field.addEventListener("input", arrange);
  wall.before(node("div", { className: "tools", role: "search" }, search, split, order, count));
  arrange();

  // --- one or two of them ----------------------------------------------------------------------

  const shown = node("main", { className: "shown", hidden: true });
  document.querySelector("main").before(shown);
  const title = document.title, scenes = new Map();
  let opened = [], wanted = [], latest = 0, waiting = 0;

  const loaded = (file) => {
    if (!scenes.has(file))
      scenes.set(file, new Promise((resolve, reject) => {
        const script = node("script", { src: file });
        script.onload = () => resolve(articugen.scene);
        script.onerror = () => // what failed is fetched again when it is opened again
          (scenes.delete(file), reject(new Error(`${file} is missing from this folder`)));
        document.head.append(script);
      }));
    return scenes.get(file);
  };
  window.articugen = { loaded: (scene) => (articugen.scene = scene), opened: () => opened };

  // Numbers belong to the object before them: one without a scene has none.
  const asked = () => location.hash.slice(1).split(/&(?=object=)/).map((text) => {
    const values = new URLSearchParams(text);
    const numbers = (name) => (values.get(name) || "").split(",").map(parseFloat);
    return { key: values.get("object"), joints: numbers("joints"), camera: numbers("camera"), text };
  }).filter(({ key }) => key !== null).slice(0, 2);
  const short = (numbers) => numbers.map((x) => +x.toPrecision(6)); // a slide may be tiny
  const linked = (key, at) => `object=${encodeURIComponent(key)}` +
    (at ? `&joints=${short(at.joints)}&camera=${short(at.camera)}` : "");
  const link = () => "#" + wanted.map(({ key, text }, n) => // as it came until it is opened
    opened[n] ? linked(key, opened[n].view?.get()) : text).join("&");
  const note = () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => opened.length && history.replaceState(null, "", link()), 300);
  };

  const card = ({ key, joints, camera }, tile, scene) => {
    const about = node("dl", { className: "keys long" },
      ...scene.lines.flatMap(([name, text]) => [node("dt", {}, name), node("dd", {}, text)]));
    const views = scene.views && node("figure", { className: "views" },
      node("img", { src: scene.views.image, alt: scene.views.text }), node("figcaption", {}, scene.views.text));
    const stage = node("div", { className: "stage" });
    const picture = tile.querySelector("img");
    if (picture) stage.append(node("img", { src: picture.src, alt: scene.name }));
    const page = node("div", { className: "card viewer" }, stage);
    const whole = node("article", {}, page, node("div", { className: "card" }, about, views || ""));
    shown.append(whole);
    if (!scene.meshes) return page.replaceWith(`${scene.name}: no surface points are stored`), { key };
    const view = turn(page, scene, note);
    if (camera.length === 3 && [...joints, ...camera].every(Number.isFinite)) view.set(joints, camera);
    return { key, view };
  };

  async function show() {
    const mine = ++latest;
    wanted = asked();
    clearTimeout(waiting);
    opened.forEach(({ view }) => view?.close());
    opened = [];
    document.body.classList.toggle("open", wanted.length > 0);
    shown.hidden = !wanted.length;
    shown.replaceChildren();
    document.title = title;
    if (!wanted.length) return;
    const seen = tiles.filter((tile) => !tile.hidden);
    const chosen = wanted.map(({ key }) => tiles.find((tile) => tile.dataset.key === key));
    const at = seen.indexOf(chosen[0]);
    const step = (name, tile) => tile ? [node("a", { href: tile.getAttribute("href") }, name)] : [];
    const beside = choice("Beside it", [["Beside it: nothing", ""], ...tiles.map(({ dataset: { key } }) => [key, key])]);
    beside.value = wanted[1]?.key ?? "";
    beside.addEventListener("input", () => {
      const first = link().slice(1).split("&object=")[0];
      location.hash = first + (beside.value && "&" + linked(beside.value));
    });
    shown.append(node("nav", { className: "tools", "aria-label": "Objects" },
      node("a", { href: "#all" }, "← All objects"), ...step("Previous", seen[at - 1]),
      ...step("Next", at < 0 ? null : seen[at + 1]), beside));
    shown.classList.toggle("two", wanted.length > 1);
    document.title = `${wanted.map(({ key }) => key).join(" beside ")}: ${title}`;
    window.scrollTo(0, 0);
    try {
      for (const [n, one] of wanted.entries()) {
        if (!chosen[n]) throw new Error(`There is no ${one.key} in this set`);
        const scene = await loaded(chosen[n].dataset.script);
        if (mine !== latest) return;
        opened.push(card(one, chosen[n], scene));
      }
      note();
    } catch (error) {
      shown.append(node("p", { className: "warn", role: "alert" }, `${error.message}.`));
    }
  }

  window.addEventListener("hashchange", show);
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && opened.length) location.hash = "#all";
  });
  show();
})();
