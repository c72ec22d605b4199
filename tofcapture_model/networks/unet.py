"""U-Net (Ronneberger 2015) with same-padding and no batch norm, which would shift absolute depths; convex x2 upsampling."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.geometry.maps import shifted


def double_conv(inputs: int, outputs: int, leak: float = 0.0) -> nn.Sequential:
    """Make two 3 x 3 convolutions with ReLU, or one that lets a share of what is negative through."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1),
        nn.LeakyReLU(leak, inplace=True),
        nn.Conv2d(outputs, outputs, 3, padding=1),
        nn.LeakyReLU(leak, inplace=True),
    )


def pad_to_multiple(image: Tensor, multiple: int) -> tuple[Tensor, tuple[int, int]]:
    """Extend (B, C, H, W) to multiples of ``multiple`` by reflection; also return the (top, left) that was added."""
    h, w = image.shape[-2:]
    extra_h, extra_w = -h % multiple, -w % multiple
    top, left = extra_h // 2, extra_w // 2
    # reflection needs more pixels than it adds; tiny images repeat their border instead
    mode = "reflect" if max(extra_h - top, extra_w - left) < min(h, w) else "replicate"
    return F.pad(image, (left, extra_w - left, top, extra_h - top), mode=mode), (top, left)


class UNet(nn.Module):
    """U-Net of any base width and number of levels, He initialised; every level doubles the width.

    ``UNet(10, 1, 64)`` has the original's widths 64 ... 1024 and 31,035,777 parameters. With ``zero_last`` the last 1 x 1
    convolution starts at zero: a residual network then begins as the identity.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        width: int = 64,
        levels: int = 5,
        *,
        zero_last: bool = False,
        leak: float = 0.0,
    ) -> None:
        super().__init__()
        widths = [width * 2**i for i in range(levels)]
        self.down = nn.ModuleList(
            double_conv(a, b, leak) for a, b in zip([inputs, *widths[:-1]], widths, strict=True)
        )
        self.up = nn.ModuleList(nn.ConvTranspose2d(2 * w, w, 2, stride=2) for w in widths[-2::-1])
        self.merge = nn.ModuleList(double_conv(2 * w, w, leak) for w in widths[-2::-1])
        self.last = nn.Conv2d(width, outputs, 1)
        self.multiple = 2 ** (levels - 1)
        self.apply(he_initialised)
        if zero_last:
            nn.init.zeros_(self.last.weight)
            nn.init.zeros_(self.last.bias) if self.last.bias is not None else None

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H, W) for any H and W."""
        h, w = image.shape[-2:]
        x, (top, left) = pad_to_multiple(image, self.multiple)
        skips: list[Tensor] = []
        for i, block in enumerate(self.down):
            x = block(x if i == 0 else F.max_pool2d(x, 2))
            skips.append(x)
        for up, merge, skip in zip(self.up, self.merge, skips[-2::-1], strict=True):
            x = merge(torch.cat([skip, up(x)], dim=1))
        out: Tensor = self.last(x)[..., top : top + h, left : left + w]
        return out


def he_initialised(module: nn.Module) -> None:
    """Initialise a convolution for the ReLU behind it (He 2015); for ``Module.apply``."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        if module.bias is not None:
            nn.init.zeros_(module.bias)


CONVEX_CHANNELS = 36  # nine neighbours for each of four sub-pixels


def bilinear_logits() -> Tensor:
    """Return (36,) logits whose softmax over the nine neighbours is bilinear x2 interpolation; its zeros are e^-14, which learns."""
    line = torch.tensor([[1.0, 3.0, 0.0], [0.0, 3.0, 1.0]]) / 4  # sub-pixel 0 leans to the previous pixel
    weights = torch.einsum("ay,bx->yxab", line, line).reshape(9, 4)
    return weights.clamp_min(math.exp(-14)).log().flatten()


def convex_upsample(image: Tensor, logits: Tensor) -> Tensor:
    """Double the resolution of (B, C, H, W) by convex combinations of 3 x 3 neighbours (RAFT's upsampling); nothing overshoots.

    ``logits`` are (B, 36, H, W): 9 neighbours x 4 sub-pixels.
    """
    b, c, h, w = image.shape
    weights = logits.float().reshape(b, 9, 4, h, w).softmax(dim=1)
    out = torch.zeros(b, c, 4, h, w, dtype=image.dtype, device=image.device)
    # indexing would fill a whole gradient for each of the nine
    for k, weight in enumerate(weights.unbind(1)):
        out = torch.addcmul(out, shifted(image, k // 3 - 1, k % 3 - 1)[:, :, None], weight[:, None])
    return F.pixel_shuffle(out.reshape(b, c * 4, h, w), 2)
