"""From the frames of a video to tracks of keypoints and masks, by ONNX networks on a CPU."""
