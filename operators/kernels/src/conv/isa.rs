use std::fmt;
use std::str::FromStr;

/// Instructions that a convolution is written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Isa {
    /// AMX, whose tiles multiply bf16 and bytes; f32 layers use AVX-512.
    Amx,
    /// AVX-512 with products of bf16; f32 layers use AVX-512.
    Avx512Bf16,
    /// AVX-512.
    Avx512,
    /// AVX2 with FMA.
    Avx2,
    /// What every CPU has.
    Portable,
}

/// No set of instructions has this name.
#[derive(Debug, thiserror::Error)]
#[error("expected auto or one of {}, found `{name}`", Isa::ALL.map(|isa| isa.to_string()).join(", "), name = .0)]
pub struct UnknownIsa(String);

impl Isa {
    /// All, best first.
    pub const ALL: [Isa; 5] = [Isa::Amx, Isa::Avx512Bf16, Isa::Avx512, Isa::Avx2, Isa::Portable];

    /// The fastest that this CPU has.
    pub fn detect() -> Isa {
        let fast = |isa: &Isa| isa.is_available() && !(*isa == Isa::Avx512Bf16 && has_slow_bf16());
        Isa::ALL.into_iter().find(fast).unwrap_or(Isa::Portable)
    }

    /// Whether it multiplies bf16.
    pub fn has_bf16(self) -> bool {
        matches!(self, Isa::Amx | Isa::Avx512Bf16)
    }

    /// Whether this CPU has it.
    #[cfg(target_arch = "x86_64")]
    pub fn is_available(self) -> bool {
        match self {
            Isa::Amx => Isa::Avx512Bf16.is_available() && super::x86::ask::is_available(),
            // The compiler takes those with bf16 to have the instructions on words too.
            Isa::Avx512Bf16 => {
                Isa::Avx512.is_available()
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512bf16")
            }
            Isa::Avx512 => is_x86_feature_detected!("avx512f"),
            Isa::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            Isa::Portable => true,
        }
    }

    /// Whether this CPU has it.
    #[cfg(not(target_arch = "x86_64"))]
    pub fn is_available(self) -> bool {
        self == Isa::Portable
    }
}

/// Whether products of bf16 take longer than those of f32 in whole registers, as on the cores of Intel: they multiply twice as many
/// numbers, but begin at a quarter of the rate.
#[cfg(target_arch = "x86_64")]
fn has_slow_bf16() -> bool {
    // Twelve letters in the order ebx, edx, ecx.
    let vendor = std::arch::x86_64::__cpuid(0);
    [vendor.ebx, vendor.edx, vendor.ecx] == [b"Genu", b"ineI", b"ntel"].map(|letters| u32::from_le_bytes(*letters))
}

#[cfg(not(target_arch = "x86_64"))]
fn has_slow_bf16() -> bool {
    false
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Isa::Amx => "amx",
            Isa::Avx512Bf16 => "avx512bf16",
            Isa::Avx512 => "avx512",
            Isa::Avx2 => "avx2",
            Isa::Portable => "portable",
        })
    }
}

impl FromStr for Isa {
    type Err = UnknownIsa;

    fn from_str(name: &str) -> Result<Self, UnknownIsa> {
        let named = Isa::ALL.into_iter().find(|isa| isa.to_string() == name);
        named.ok_or_else(|| UnknownIsa(name.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_back() {
        for isa in Isa::ALL {
            assert_eq!(isa.to_string().parse::<Isa>().unwrap(), isa);
        }
        assert!("sse".parse::<Isa>().unwrap_err().to_string().contains("found `sse`"));
    }

    #[test]
    fn a_cpu_has_what_was_detected() {
        assert!(Isa::detect().is_available());
        assert!(Isa::Portable.is_available());
    }
}
