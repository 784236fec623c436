// A camera of the device: its video, and its frames as JPEG, at the rate and in the size that are of use.

const GOOD_PX = 640, MAX_FPS = 30, QUALITY = 0.8;

export class Camera {
  #video; #onFrame; #canvas = document.createElement("canvas");
  #stream = null; #longSide = GOOD_PX; #interval = 1 / MAX_FPS; #takenAt = 0; #busy = false; #paused = false;
  /** Whether a frame would be of use now. */
  mayTake = () => true;

  /** `onFrame` gets {jpeg, timeS} for each frame that is taken. */
  constructor(video, onFrame) {
    this.#video = video;
    this.#onFrame = onFrame;
  }

  /** Ask for the camera that looks away from the user, and begin. Rejects, in plain words, where there is none. */
  async start() {
    // Browsers hide the camera from pages whose connection others could change.
    if (!navigator.mediaDevices?.getUserMedia) throw new Error("Browsers allow the camera on HTTPS addresses and on this machine only. Start the service with --https.");
    try {
      const wanted = { facingMode: { ideal: "environment" }, width: { ideal: 1280 }, height: { ideal: 960 }, frameRate: { ideal: MAX_FPS } };
      this.#stream = await navigator.mediaDevices.getUserMedia({ video: wanted, audio: false });
    } catch (error) {
      throw new Error({
        NotAllowedError: "The camera was not allowed. Allow it in the browser's settings for this page.",
        NotFoundError: "There is no camera.",
        NotReadableError: "The camera is in use by another program.",
      }[error.name] ?? `The camera can't be used: ${error.message}`);
    }
    this.#video.srcObject = this.#stream;
    await this.#video.play();
    this.#next();
  }

  stop() {
    this.#stream?.getTracks().forEach(track => track.stop());
    this.#stream = this.#video.srcObject = null;
  }

  pause() { this.#paused = true; }
  resume() { this.#paused = false; }

  /** Take the service's advice: frames a second, and pixels of the long side; null: as it was meant. */
  advise({ max_fps: fps, long_side_px: longSide }) {
    this.#interval = 1 / Math.min(fps ?? MAX_FPS, MAX_FPS);
    this.#longSide = longSide ?? GOOD_PX;
  }

  #next() {
    if (!this.#stream) return;
    const again = () => { this.#take(); this.#next(); };
    // Called once for each new picture; Firefox has it since 2024.
    if (this.#video.requestVideoFrameCallback) this.#video.requestVideoFrameCallback(again);
    else setTimeout(again, 1000 / MAX_FPS);
  }

  async #take() {
    const now = performance.now() / 1000;
    // A tenth early: pictures don't come at exactly equal times.
    if (this.#busy || this.#paused || !this.mayTake() || now - this.#takenAt < 0.9 * this.#interval) return;
    const { videoWidth: width, videoHeight: height } = this.#video;
    if (!width) return;
    this.#busy = true;
    this.#takenAt = now;
    const scale = Math.min(1, this.#longSide / Math.max(width, height));
    this.#canvas.width = Math.round(width * scale);
    this.#canvas.height = Math.round(height * scale);
    this.#canvas.getContext("2d").drawImage(this.#video, 0, 0, this.#canvas.width, this.#canvas.height);
    const blob = await new Promise(resolve => this.#canvas.toBlob(resolve, "image/jpeg", QUALITY));
    const jpeg = blob && await blob.arrayBuffer();
    this.#busy = false;
    if (jpeg && this.#stream && this.mayTake()) this.#onFrame({ jpeg, timeS: now });
  }
}
