// A video of the picture, by the browser's own encoder.

const KINDS = ["video/mp4;codecs=avc1.640028", "video/mp4", "video/webm;codecs=vp9", "video/webm"];
const RATE = 30; // pictures per second
const BITS = 8e6; // per second

/** What the browser can record a canvas as, MP4 if possible; null for nothing. */
export function videoKind(canvas) {
  if (!canvas.captureStream || typeof MediaRecorder === "undefined") return null;
  return KINDS.find((kind) => MediaRecorder.isTypeSupported(kind)) ?? null;
}

export class Video {
  constructor(canvas, kind) {
    const options = { mimeType: kind, videoBitsPerSecond: BITS };
    this.stream = canvas.captureStream(RATE);
    this.recorder = new MediaRecorder(this.stream, options);
    this.recorder.start();
  }

  /** End it; `done` gets the file. */
  stop(done) {
    if (this.recorder.state === "inactive") return;
    const chunks = [];
    this.recorder.ondataavailable = ({ data }) => chunks.push(data);
    this.recorder.onstop = () => done(new Blob(chunks, { type: this.recorder.mimeType }));
    this.recorder.stop();
    for (const track of this.stream.getTracks()) track.stop();
  }
}

/** Hand a file to the reader. */
export function download(file, name) {
  const ending = file.type.startsWith("video/mp4") ? "mp4" : "webm";
  const safe = name.replace(/[^\p{L}\p{N}._-]+/gu, "-");
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(file), download: `${safe}.${ending}` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
