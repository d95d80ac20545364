"""Speech without PyTorch: reading recordings, windows and the frame clock, pauses, prosody, denoising, phonemes."""
