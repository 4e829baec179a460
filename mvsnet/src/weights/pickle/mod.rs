//! A pickle interpreter that can build numbers, strings, lists, dictionaries and descriptions of
//! tensors, and nothing else.
//!
//! Python's own reader imports and calls whatever a pickle names. This one knows the few names that
//! PyTorch writes into checkpoints and refuses every other by name, so no file can run code. Containers live in
//! flat arenas, so no nesting depth can exhaust the stack when they are dropped.

mod machine;
mod value;

use std::collections::BTreeMap;
use std::rc::Rc;

use thiserror::Error;

use self::machine::Machine;
use self::value::Arena;
pub(super) use self::value::{ElementType, Storage, TensorRef, Value};

/// Far more than any checkpoint of this network needs (the reference's has 9000 with its optimiser).
const MAX_INSTRUCTIONS: usize = 2_000_000;

/// Why a pickle is refused. Offsets are in bytes from the start of the pickle.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum PickleError {
    /// The bytes end within an instruction.
    #[error("pickle is truncated at byte {at}")]
    Truncated {
        /// Where.
        at: usize,
    },
    /// It names a function or class that tensors do not need.
    #[error("pickle asks for \"{name}\" at byte {at}, which no weights need; nothing was executed")]
    Forbidden {
        /// The function or class.
        name: String,
        /// Where.
        at: usize,
    },
    /// It holds an instruction that checkpoints do not use.
    #[error("pickle instruction {opcode:#04x} at byte {at} is none that weights need")]
    UnknownInstruction {
        /// The instruction.
        opcode: u8,
        /// Where.
        at: usize,
    },
    /// Its instructions do not fit together.
    #[error("pickle is malformed at byte {at}: {what}")]
    Malformed {
        /// Where.
        at: usize,
        /// What is wrong.
        what: &'static str,
    },
    /// It is too long.
    #[error("pickle has more than {MAX_INSTRUCTIONS} instructions")]
    TooLong,
}

/// A finished pickle.
#[derive(Debug)]
pub(super) struct Pickle {
    pub(super) root: Value,
    /// Every storage that the pickle refers to, by key.
    pub(super) storages: BTreeMap<Rc<str>, Storage>,
    /// Bytes read, up to and including the last instruction.
    pub(super) bytes: usize,
    arena: Arena,
}

impl Pickle {
    /// Interprets the pickle that `bytes` start with.
    pub(super) fn read(bytes: &[u8]) -> Result<Self, PickleError> {
        let mut machine = Machine::new(bytes);
        for _ in 0..MAX_INSTRUCTIONS {
            if let Some(root) = machine.step()? {
                return Ok(machine.finished(root));
            }
        }
        Err(PickleError::TooLong)
    }

    /// The items of a list or tuple.
    pub(super) fn sequence(&self, value: &Value) -> Option<&[Value]> {
        match value {
            Value::List(index) | Value::Tuple(index) => Some(&self.arena.sequences[*index]),
            _ => None,
        }
    }

    /// The entries of a dictionary whose keys are strings, in the order of the file.
    pub(super) fn entries(&self, value: &Value) -> Option<impl Iterator<Item = (&Rc<str>, &Value)>> {
        let Value::Dict(index) = value else { return None };
        Some(self.arena.dicts[*index].iter().filter_map(|(key, value)| match key {
            Value::Str(key) => Some((key, value)),
            _ => None,
        }))
    }

    /// The value at a key of a dictionary.
    pub(super) fn get(&self, value: &Value, key: &str) -> Option<&Value> {
        self.entries(value)?.find_map(|(name, value)| (&**name == key).then_some(value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn code_is_refused_by_name_and_not_run() {
        // What `pickle.dumps` makes of an object whose `__reduce__` is `(os.system, ("true",))`.
        let bytes = b"\x80\x02cposix\nsystem\nq\x00X\x04\x00\x00\x00trueq\x01\x85q\x02Rq\x03.";
        let error = Pickle::read(bytes).expect_err("code");
        assert_eq!(error, PickleError::Forbidden { name: "posix.system".into(), at: 2 });
        let bytes = b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93.";
        let error = Pickle::read(bytes).expect_err("code");
        assert_eq!(error, PickleError::Forbidden { name: "builtins.eval".into(), at: 18 });
    }

    #[test]
    fn containers_are_filled_after_they_were_kept() {
        let bytes = b"\x80\x02}q\x00(X\x01\x00\x00\x00aK\x05X\x01\x00\x00\x00b]q\x01(K\x01M\x00\x02eu.";
        let pickle = Pickle::read(bytes).expect("a dictionary");
        assert_eq!(pickle.get(&pickle.root, "a"), Some(&Value::Int(5)));
        let list = pickle.get(&pickle.root, "b").expect("an entry");
        assert_eq!(pickle.sequence(list), Some(&[Value::Int(1), Value::Int(512)][..]));
        assert_eq!(pickle.bytes, bytes.len());
    }

    #[test]
    fn big_integers_keep_their_sign() {
        let pickle = Pickle::read(b"\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.").expect("a number");
        assert_eq!(pickle.root, Value::Int(0x1950_a86a_20f9_469c_fc6c));
        assert_eq!(Pickle::read(b"\x8a\x01\xff.").expect("a number").root, Value::Int(-1));
    }

    #[test]
    fn lengths_beyond_the_file_allocate_nothing() {
        let error = Pickle::read(b"X\xff\xff\xff\xffabc").expect_err("a string of 4 GiB");
        assert_eq!(error, PickleError::Truncated { at: 8 });
    }

    #[test]
    fn nesting_does_not_exhaust_the_stack() {
        let mut bytes = vec![b')'];
        bytes.resize(1_000_000, 0x85);
        bytes.push(b'.');
        assert!(Pickle::read(&bytes).is_ok());
        bytes.insert(0, b'(');
        assert!(matches!(Pickle::read(&vec![b'N'; MAX_INSTRUCTIONS + 1]), Err(PickleError::TooLong)));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_do_not_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = Pickle::read(&bytes);
        }

        #[test]
        fn arbitrary_instructions_do_not_panic(
            picks in proptest::collection::vec(proptest::sample::select(b"}])(NtaesuRQbqhK\x85\x86.".to_vec()), 0..60),
        ) {
            let _ = Pickle::read(&picks);
        }
    }
}
