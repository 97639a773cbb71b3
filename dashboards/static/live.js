// Parts of the page come over server-sent events as the server made them; pictures one at a time.

const live = document.getElementById("live");
const cameras = document.getElementById("previews");
const loading = new Set();

function showPicture(name, number) {
  let figure = [...cameras.querySelectorAll("figure")].find((each) => each.dataset.camera === name);
  if (!figure) {
    figure = document.createElement("figure");
    figure.dataset.camera = name;
    const caption = document.createElement("figcaption");
    caption.textContent = name;
    const image = document.createElement("img");
    image.alt = "camera " + name + ", now";
    figure.append(image, caption);
    cameras.querySelector(".previews").append(figure);
    cameras.hidden = false;
  }
  if (loading.has(name) || figure.dataset.number === String(number)) return;
  loading.add(name);
  const next = new Image();
  next.onload = () => {
    loading.delete(name);
    figure.dataset.number = String(number);
    figure.querySelector("img").src = next.src;
  };
  next.onerror = () => loading.delete(name);
  next.src = live.dataset.preview + encodeURIComponent(name) + "?n=" + number;
}

function take(parts) {
  for (const place of live.querySelectorAll("[data-part]")) {
    const html = parts[place.dataset.part];
    if (html !== undefined) place.innerHTML = html;
  }
  for (const [name, number] of parts.previews || []) showPicture(name, number);
}

const events = new EventSource(live.dataset.events);
events.onmessage = (event) => take(JSON.parse(event.data));
events.addEventListener("full", () => {
  events.close();
  live.querySelector("[data-part=summary]").textContent = "Too many pages listen already; close one and reload.";
});
events.onerror = () => live.classList.add("lost");
events.onopen = () => live.classList.remove("lost");
