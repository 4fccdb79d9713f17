"""Perception: from the frames of a video to tracks of keypoints and masks, with ONNX networks on a CPU."""
