// The pile of a diggability map: places in the colours of the quantity that is chosen.
(() => {
  const choice = document.getElementById("shade"), said = document.getElementById("said");
  const at = (k) => scene.places.map((place) => place[k]);

  function show() {
    const { title, unit, digits, values, much } = scene.shades[choice.querySelector("input:checked").value];
    const places = { type: "scatter3d", mode: "markers", x: at(0), y: at(1), z: at(2), name: "",
      text: values.map((value, k) => `${scene.said[k]}: ${value.toFixed(digits)} ${unit}`), hoverinfo: "text",
      marker: { size: 6, color: values, colorscale: "Viridis", reversescale: !much,
        line: { color: "#ffffff", width: 1 },
        colorbar: { title: { text: title, side: "top" }, orientation: "h", len: 0.6, thickness: 12, y: 1, yanchor: "top" } } };
    const range = [Math.min(...values), Math.max(...values)].map((value) => value.toFixed(digits));
    said.textContent = `${title}: ${range[0]} to ${range[1]}; yellow is good`;
    return pile.draw([pile.surface(pile.first), places]);
  }

  pile.start(show).then(() => choice.addEventListener("change", show));
})();
