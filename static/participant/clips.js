// Loads clips ahead of time, whole and into memory: phones ignore preload hints.

const PATIENCE_MS = 20000;
const held = new Map(); // path -> promise of an object URL

export function preload(path) {
  if (!held.has(path)) {
    const loading = fetch(path, { signal: AbortSignal.timeout(PATIENCE_MS) })
      .then((response) => (response.ok ? response.blob() : Promise.reject(new Error(`status ${response.status}`))))
      .then((blob) => URL.createObjectURL(blob));
    loading.catch(() => held.delete(path));
    held.set(path, loading);
  }
  return held.get(path);
}

// A fresh video element for this clip; its data come from memory if it was preloaded, else from the server.
export async function makeVideo(clip, label, width, height) {
  const video = document.createElement("video");
  Object.assign(video, { muted: true, playsInline: true, preload: "auto", poster: clip.poster, width, height });
  video.disablePictureInPicture = true;
  video.setAttribute("aria-label", label);
  video.src = await (held.get(clip.video) ?? Promise.resolve(clip.video)).catch(() => clip.video);
  video.load();
  return video;
}

// Frees everything but these clips.
export function keepOnly(paths) {
  for (const [path, loading] of held) {
    if (paths.includes(path)) continue;
    held.delete(path);
    loading.then(URL.revokeObjectURL).catch(() => {});
  }
}
